"""Plain configuration data: reading within bounds, changing, comparing."""
