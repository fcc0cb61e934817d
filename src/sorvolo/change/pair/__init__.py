"""Two aligned pictures of one ground: which pixels and regions changed."""
