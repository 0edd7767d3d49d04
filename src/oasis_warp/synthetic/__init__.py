"""A world of synthetic hands: identities, gestures, light, rooms and a camera, all drawn from a seed."""
