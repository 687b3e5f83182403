"""What the method's claims rest on: pieces that measure, and the page that is made of their results."""
