"""The learned prior: the paper's network, from one photo and the fitted surface to canonical Gaussians."""
