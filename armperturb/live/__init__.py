"""A page on which anybody can turn an arm's properties and see what follows, without a network or an install."""
