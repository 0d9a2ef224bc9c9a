// A search for --min-reliability means the option: without this, the dashes would exclude words
const query = document.querySelector("[data-md-component=search-query]");
const { get, set } = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value");
Object.defineProperty(query, "value", { get() { return get.call(this).replace(/(^|\s)-+(?=\w)/g, "$1"); }, set });
