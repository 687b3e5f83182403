"""Programs in the controller: its memory, its reading of their statements, and its frames."""
