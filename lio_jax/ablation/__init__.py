"""Many runs at once, compared fairly: recordings x settings, each run once, gathered into a table."""
