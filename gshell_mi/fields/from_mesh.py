def from_mesh(*a, **k):
    raise NotImplementedError
