"""Show, measure and describe the nodes and topics of a master. Loaded when first used."""
