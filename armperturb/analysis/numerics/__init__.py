"""Numerical methods that no library has."""
