"""What a GPU has to show."""
