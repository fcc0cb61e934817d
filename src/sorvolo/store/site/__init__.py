"""The site folder: its files, catalogue, tiles and exports."""
