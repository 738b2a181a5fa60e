"""Checks that bags are whole, and repair of damaged ones."""
