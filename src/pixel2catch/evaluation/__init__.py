"""How often policies catch: protocol, metrics, report; `comparison` of methods, `stress` by disturbances."""
