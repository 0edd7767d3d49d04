"""Training the networks on synthetic hands."""
