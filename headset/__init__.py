"""A headset and two controllers, recorded or live: reader, calibration, the character they drive."""
