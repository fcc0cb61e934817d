"""Alembic migrations of the catalogue, from the oldest format that is read to the newest."""
