"""A site copied whole: to another folder or to an object store, verified, and never over what it lacks itself."""
