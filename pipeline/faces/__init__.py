"""Face detection in photos, offline, by two small networks (models/NOTICE)."""
