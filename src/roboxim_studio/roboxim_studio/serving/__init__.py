"""The page's server, and who may reach it."""
