"""Skeleton-aware networks: unpaired retargeting between skeletons (Aberman et al. 2020)."""
