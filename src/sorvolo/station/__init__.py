"""The ground station: sites, missions and live events of one folder, served to browsers and to other programs."""
