"""What a site remembers: its versions and the reviews of its changes."""
