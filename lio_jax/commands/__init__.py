"""What the command line does, one module each: compose the package's parts and print."""
