import pytest

from tests.tg.robots import SUBJECTS


@pytest.fixture(scope="session", params=sorted(SUBJECTS))
def subject(request):
    return SUBJECTS[request.param]
