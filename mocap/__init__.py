"""Motion capture: any rig to the canonical human of human.py; stitching, augmentation, data sets."""
