"""The thesis's experiment as a whole: protocol, runner, published tables, figures, report."""
