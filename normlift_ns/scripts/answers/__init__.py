"""Tables and files of ns-normlift-query and ns-normlift-export."""
