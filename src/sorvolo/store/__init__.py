"""Everything on disk: the site folder, its catalogue, tiles and keyframes, and what is made from them."""
