"""From settings to recordings."""
