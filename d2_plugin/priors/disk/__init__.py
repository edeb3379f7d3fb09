"""Maps of numbers that lie beside the pictures: how they are read, and how sure they say they are."""
