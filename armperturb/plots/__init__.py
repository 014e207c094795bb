"""What figures of commands and reports share."""
