"""Where things stand: the tracker in the assembly frame, reference checks."""
