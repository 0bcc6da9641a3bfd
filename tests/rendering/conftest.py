import pytest

from pixel2catch.errors import DeviceUnavailableError
from pixel2catch.rendering.renderer import find_gl_backend


@pytest.fixture
def opengl() -> None:
    """Skip what draws where no OpenGL back end works."""
    try:
        find_gl_backend()
    except DeviceUnavailableError as error:
        pytest.skip(str(error))
