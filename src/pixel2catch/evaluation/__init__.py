"""Protocol, metrics, stress suite, tables, figures, and pictures of trained policies."""
