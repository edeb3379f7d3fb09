"""The official trainers themselves: each repository's own script, bare, with D2 without hooks, and with all."""
