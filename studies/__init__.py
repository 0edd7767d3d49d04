"""Studies: what the documentation claims, measured again with `python -m studies NAME` and rendered into its pages."""
