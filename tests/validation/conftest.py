import pytest


@pytest.fixture(scope="session")
def device(request: pytest.FixtureRequest) -> str:
    """The device of the option --device."""
    return request.config.getoption("--device")
