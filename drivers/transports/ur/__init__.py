"""The driver for Universal Robots: CB3 and e-Series controllers, docs/how-to-ur.md."""
