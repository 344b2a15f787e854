"""The commands of the command line, one module for each: compose the package's parts and print results."""
