"""How did this log come about?"""
