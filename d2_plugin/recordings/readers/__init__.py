"""One file per layout of recordings on disk."""
