"""How good a map or a placement is, and how sure that is."""
