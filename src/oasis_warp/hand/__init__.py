"""From a photo to a posed hand: the hand model, landmarks, mask and fit."""
