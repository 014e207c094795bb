"""Experiment design."""
