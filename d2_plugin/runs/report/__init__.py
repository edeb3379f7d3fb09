"""Everything measured, as one page."""
