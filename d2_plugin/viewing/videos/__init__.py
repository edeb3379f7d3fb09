"""Videos: where the camera stands at each image, which instant it shows, and the file that holds them."""
