"""Following people through a recording."""
