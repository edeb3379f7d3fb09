"""What the other views of an instant say about the points of one: in C++, and in NumPy where there is no compiler."""
