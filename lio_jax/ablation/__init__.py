"""Many runs compared fairly: each recording runs once with each set of settings."""
