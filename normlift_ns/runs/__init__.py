"""Reading and writing the files of a lifted run."""
