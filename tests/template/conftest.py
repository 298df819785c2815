import pytest
import trimesh


@pytest.fixture(scope="session")
def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(4)
