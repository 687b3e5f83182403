"""Set-up commands: recipe, checks, installation, timer."""
