"""The MJCF files of arm and manipulator, and the function that compiles them for a person."""
