"""The nouns that stages hand to each other, and what needs nothing but torch."""
