"""The depth prior of a run: built before it trains, or beside."""
