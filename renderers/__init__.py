"""From a shape to what one viewpoint sees of it: depth rendering, hidden point removal, sensors."""
