"""Bundle adjustment from two views to thousands."""
