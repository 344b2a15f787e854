"""Settings of a run: what a recipe, the runner and the back end declare, read from YAML and checked
strictly."""
