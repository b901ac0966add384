"""Trained networks that are no character's, as package data."""
