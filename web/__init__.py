"""The page: a headset, or a recording of one, drives a simulated character in the visitor's own browser."""
