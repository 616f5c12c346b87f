"""A small world whose geometry, materials, temperatures and times are known: solved, ray-traced and filmed."""
