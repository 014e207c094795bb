"""Monte-Carlo validation of the estimators."""
