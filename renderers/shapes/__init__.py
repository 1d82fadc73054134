"""Built-in parametric CAD families, one per ModelNet40 class: the embedded default source."""
