"""Scenes that a renderer turns into images, one per module; nothing is downloaded."""
