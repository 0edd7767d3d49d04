"""Photos of hands that others published with MANO's parameters: their file trees as samples of one kind."""
