"""What a person sets up: recipe, checks, installation, timer."""
