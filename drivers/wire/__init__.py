"""The format of each wire as data, pinned by golden bytes. For drivers and the fake controller alone."""
