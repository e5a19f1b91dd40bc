"""Having nodes drive an arm: they run in processes of their own, and a client sends goals and watches."""
