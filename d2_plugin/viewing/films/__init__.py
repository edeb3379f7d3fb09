"""Films: where the camera stands at each picture, which instant it shows, and the file that holds them."""
