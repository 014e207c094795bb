"""Where the experiment runs."""
