"""Ours, beyond the paper: recipes, shipping, GPU, Gymnasium, benchmarks."""
