"""How values look to others: JSON documents written and read, and samples as
arrays or tables."""
