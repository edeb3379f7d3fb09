"""The paper's tables on any recording."""
