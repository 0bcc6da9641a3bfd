"""How often policies catch: protocol, metrics, and studies as grids of cells with one kind of report."""
