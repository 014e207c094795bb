"""Identification of one joint whose parameters change over time or with posture."""
