"""One library call per command: files and options in, files and a table of numbers out."""
