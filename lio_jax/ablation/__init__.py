"""Many runs compared fairly: each recording runs once with each settings; a table shows all results."""
