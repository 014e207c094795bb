"""Nonlinear identification: muscle law and reflexes of one person, from raw trials of any amplitude, task and pulse."""
