"""URScript, the program language of Universal Robots, and how their controllers move."""
