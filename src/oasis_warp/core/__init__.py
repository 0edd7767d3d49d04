"""The nouns that stages hand to each other, and the checks at the public border."""
