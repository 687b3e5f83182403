"""What a further motion is worth: the planned one against other ways to spend the same robot time, on withheld runs."""
