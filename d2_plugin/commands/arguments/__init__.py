"""What a command takes: from declared settings to flags, help and checked values."""
