"""Arm models that are fitted to recordings."""
