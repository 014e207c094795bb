"""Self-contained HTML pages: skeleton, style, how numbers are written, and figures inside a page."""
