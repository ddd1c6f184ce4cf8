def plain_days():
    return 1.0


def environment_days():
    return 1.0
