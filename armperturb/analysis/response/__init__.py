"""Frequency responses without a model of the arm."""
