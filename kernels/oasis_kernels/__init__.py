"""Warp kernels of oasis_warp. Import the module of the kernel you launch; nothing is loaded here."""
