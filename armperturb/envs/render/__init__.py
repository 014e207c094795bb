"""Pictures, videos and the viewer."""
