"""Photo to hand fit: landmarks, mask, shape, pose, camera, outline, and warnings about the fit."""
