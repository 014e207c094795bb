"""The page of an identification: one HTML file about one recording session of one person."""
