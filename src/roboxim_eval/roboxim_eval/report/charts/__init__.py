"""Charts of reports: plain values in, rows for a template or inline SVG out. Colours come from the page's style."""
