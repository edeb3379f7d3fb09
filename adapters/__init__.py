"""One file per codebase: from its objects to the contract of `d2_plugin.protocol`."""
