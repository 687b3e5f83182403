"""What will move, settled before anything moves: the loop, its program and its sub-region; what `agent plan` writes."""
