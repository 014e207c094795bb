"""Identification of the muscle law."""
