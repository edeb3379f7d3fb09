"""One function per format of calibration files: a document in, its cameras out, or None where it is another format."""
