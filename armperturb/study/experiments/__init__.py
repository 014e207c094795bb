"""Experiments around the study: calibration, mechanisms, a moving shoulder."""
