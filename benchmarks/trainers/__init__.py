"""The official trainers themselves: each repository's own script, bare, with D2 attached without hooks, and with all.

`trials` says of each repository what its script needs, `inside` runs in the script's process, `bench` compares.
"""
