"""One experiment a file: its docstring holds the command and the numbers to expect."""
