"""The page of a diagnosis, and what other pages show of one."""
