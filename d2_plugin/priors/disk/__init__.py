"""Maps of numbers that lie beside the images: how they are read, and how sure they say they are."""
