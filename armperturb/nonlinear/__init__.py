"""Nonlinear identification: the muscle law of one person, from raw recordings of several amplitudes, tasks and pulses."""
