"""DROP: a projective-dynamics human with a motion prior (Jiang et al. 2023)."""
