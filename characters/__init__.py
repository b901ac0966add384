"""The characters: NAME.xml (MJCF), NAME.toml (tables) and the trained NAME.npz, as package data."""
